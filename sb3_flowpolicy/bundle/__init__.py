"""Models as one file without code: written by ``save_safe``, read by ``load_safe``."""

from sb3_flowpolicy.bundle.container import BundleError
from sb3_flowpolicy.bundle.model import load_bundle, save_bundle
from sb3_flowpolicy.bundle.normalization import Normalization

__all__ = ["BundleError", "Normalization", "load_bundle", "save_bundle"]
