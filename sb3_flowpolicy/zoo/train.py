"""`python -m sb3_flowpolicy.zoo.train`: rl_zoo3.train, with our algorithms."""

from sb3_flowpolicy.zoo.launcher import run

if __name__ == "__main__":
    run("train")
