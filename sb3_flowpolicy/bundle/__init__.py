"""Models as one file without code: ``save_bundle`` writes it, ``load_bundle`` reads it."""

from sb3_flowpolicy.bundle.container import BundleError
from sb3_flowpolicy.bundle.model import load_bundle, save_bundle

__all__ = ["BundleError", "load_bundle", "save_bundle"]
