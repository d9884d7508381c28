"""Chapter 3 of the thesis as experiments: `python -m sb3_flowpolicy.experiments list|run|report`."""
