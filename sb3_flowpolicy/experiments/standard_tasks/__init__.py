"""Are our policies worse than stock on standard tasks?"""
