"""`python -m sb3_flowpolicy.zoo.record_video`: rl_zoo3.record_video, with our algorithms."""

from sb3_flowpolicy.zoo.launcher import run

if __name__ == "__main__":
    run("record_video")
