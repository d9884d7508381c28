"""Shared settings: tests run in parallel, so each keeps to one thread."""

import torch as th

th.set_num_threads(1)
