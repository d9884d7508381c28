"""Chapter 3 of the thesis: `python -m sb3_flowpolicy.experiments list|run|report`."""
