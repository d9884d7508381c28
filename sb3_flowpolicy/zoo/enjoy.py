"""`python -m sb3_flowpolicy.zoo.enjoy`: rl_zoo3.enjoy, with our algorithms."""

from sb3_flowpolicy.zoo.launcher import run

if __name__ == "__main__":
    run("enjoy")
