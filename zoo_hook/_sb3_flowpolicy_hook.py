"""Start-up hook that makes `python -m rl_zoo3.train --algo sac_flow` work as typed.

rl_zoo3 fixes the choices of `--algo` during its import and has no entry points, so algorithms must
be registered at that time. A `.pth` line calls `install` whenever Python starts. The installed
finder waits for rl_zoo3 and then calls `sb3_flowpolicy.zoo.plug_in`.

Every Python process of the environment runs this file. It therefore imports only modules that the
interpreter has already loaded and never raises. `SB3_FLOWPOLICY_NO_ZOO_HOOK=1` disables it.
"""

import os
import sys

OFF_SWITCH = "SB3_FLOWPOLICY_NO_ZOO_HOOK"
TARGETS = ("rl_zoo3.utils", "rl_zoo3.hyperparams_opt", "rl_zoo3.exp_manager")


class ZooFinder:
    """Meta-path finder that delegates to the other finders and notices when a target has run."""

    def __init__(self):
        self.waiting = set(TARGETS)

    def find_spec(self, name, path=None, target=None):
        """Return the other finders' spec for a target, with its loader wrapped."""
        if name not in self.waiting:
            return None
        # Another finder may ask all others in turn: avoid endless recursion.
        self.waiting.remove(name)
        try:
            spec = self._ask_others(name, path, target)
        finally:
            self.waiting.add(name)
        if hasattr(getattr(spec, "loader", None), "exec_module"):
            spec.loader = NotifyingLoader(spec.loader, self.plug_in)
        return spec

    def _ask_others(self, name, path, target):
        for finder in list(sys.meta_path):
            if finder is self or not hasattr(finder, "find_spec"):
                continue
            spec = finder.find_spec(name, path, target)
            if spec is not None:
                return spec
        return None

    def plug_in(self, module):
        """Pass an imported target to `sb3_flowpolicy.zoo`; remove this finder after the last."""
        self.waiting.discard(module.__name__)
        try:
            from sb3_flowpolicy.zoo import plug_in

            plug_in(module)
        except Exception as error:
            # rl_zoo3 must keep working without our algorithms. One warning is enough.
            self.waiting.clear()
            import warnings

            warnings.warn(
                f"sb3_flowpolicy could not register with rl_zoo3: {error!r}",
                RuntimeWarning,
                stacklevel=2,
            )
        if not self.waiting and self in sys.meta_path:
            sys.meta_path.remove(self)


class NotifyingLoader:
    """Loader that behaves like the wrapped one and calls `notify(module)` after it ran."""

    def __init__(self, loader, notify):
        self.loader = loader
        self.notify = notify

    def __getattr__(self, name):
        return getattr(self.loader, name)

    def exec_module(self, module):
        """Run the module, with its real loader in its attributes, then notify."""
        module.__spec__.loader = module.__loader__ = self.loader
        self.loader.exec_module(module)
        self.notify(module)


def install():
    """Put a `ZooFinder` first on the meta path, once, unless disabled."""
    if os.environ.get(OFF_SWITCH, "0") not in ("", "0"):
        return
    if not any(isinstance(finder, ZooFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, ZooFinder())
