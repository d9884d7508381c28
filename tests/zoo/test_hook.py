"""The start-up hook, in interpreters with stand-ins for both packages."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HOOK = Path(__file__).parents[2] / "zoo_hook"
INSTALL = "import _sb3_flowpolicy_hook as hook; hook.install()\n"
ALL_TARGETS = "import rl_zoo3.utils, rl_zoo3.hyperparams_opt, rl_zoo3.exp_manager\n"


@pytest.fixture
def site(tmp_path):
    """A folder that stands for site-packages: hook, fake rl_zoo3, fake sb3_flowpolicy."""
    for name in ("_sb3_flowpolicy_hook.py", "_sb3_flowpolicy_hook.pth"):
        shutil.copy(HOOK / name, tmp_path)
    write(tmp_path, "rl_zoo3/__init__.py", "from rl_zoo3.utils import ALGOS\n")
    write(tmp_path, "rl_zoo3/utils.py", "ALGOS = ['sac']\nprint('ran utils')\n")
    write(tmp_path, "rl_zoo3/hyperparams_opt.py", "print('ran hyperparams_opt')\n")
    write(
        tmp_path,
        "rl_zoo3/exp_manager.py",
        "import rl_zoo3.hyperparams_opt, rl_zoo3.utils\nprint('ran exp_manager')\n",
    )
    write(tmp_path, "rl_zoo3/train.py", "from rl_zoo3.utils import ALGOS\nprint(ALGOS)\n")
    write(tmp_path, "sb3_flowpolicy/__init__.py", "")
    write(
        tmp_path,
        "sb3_flowpolicy/zoo.py",
        "def plug_in(module):\n"
        "    print('plugged', module.__name__.partition('.')[2])\n"
        "    if hasattr(module, 'ALGOS'):\n"
        "        module.ALGOS.append('sac_flow')\n",
    )
    return tmp_path


def write(folder, name, text):
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


def run(site, *arguments, **environment):
    """Run Python without any site-packages; return its lines of output and of errors."""
    done = subprocess.run(
        [sys.executable, "-S", *arguments],
        env={**os.environ, "PYTHONPATH": str(site), **environment},
        cwd=site,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr.splitlines()


def test_each_target_is_plugged_right_after_it_ran(site):
    out, err = run(site, "-c", INSTALL + "import rl_zoo3.exp_manager")
    assert out == [
        "ran utils",
        "plugged utils",
        "ran hyperparams_opt",
        "plugged hyperparams_opt",
        "ran exp_manager",
        "plugged exp_manager",
    ]
    assert not err


def test_a_script_of_rl_zoo3_sees_the_algorithm(site):
    # `-m` imports the package before it runs the script, as with the real rl_zoo3.
    bootstrap = "import runpy; runpy.run_module('rl_zoo3.train', run_name='__main__')"
    out, _ = run(site, "-c", INSTALL + bootstrap)
    assert out[-1] == "['sac', 'sac_flow']"


def test_modules_keep_their_own_loader(site):
    code = (
        "import rl_zoo3.utils as utils\n"
        "print(type(utils.__loader__).__name__, utils.__spec__.loader is utils.__loader__)"
    )
    out, _ = run(site, "-c", INSTALL + code)
    assert out[-1] == "SourceFileLoader True"


def test_finding_a_spec_does_not_use_up_the_hook(site):
    look = "import importlib.util as u; print(bool(u.find_spec('rl_zoo3.exp_manager').origin))\n"
    out, _ = run(site, "-c", INSTALL + look + ALL_TARGETS)
    assert out.count("plugged exp_manager") == 1


def test_the_finder_is_removed_when_it_is_done(site):
    state = "import sys; print([type(f).__name__ for f in sys.meta_path].count('ZooFinder'))\n"
    out, _ = run(site, "-c", INSTALL + INSTALL + state + ALL_TARGETS + state)
    assert (out[0], out[-1]) == ("1", "0")


def test_two_finders_that_delegate_to_each_other_do_not_hang(site):
    rival = (
        "import sys\n"
        "class Rival:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        others = (f for f in sys.meta_path if f is not self)\n"
        "        specs = (f.find_spec(name, path, target) for f in others)\n"
        "        return next((spec for spec in specs if spec), None)\n"
        "sys.meta_path.insert(0, Rival())\n"
    )
    out, err = run(site, "-c", INSTALL + rival + ALL_TARGETS)
    assert [line for line in out if "plugged" in line] == [
        "plugged utils",
        "plugged hyperparams_opt",
        "plugged exp_manager",
    ]
    assert not err


def test_a_broken_install_costs_one_warning_and_nothing_else(site):
    write(site, "sb3_flowpolicy/zoo.py", "import a_missing_package\n")
    out, err = run(site, "-c", INSTALL + ALL_TARGETS + "print(rl_zoo3.ALGOS)")
    assert out[-1] == "['sac']"
    warnings = [line for line in err if "RuntimeWarning" in line]
    assert len(warnings) == 1
    assert "a_missing_package" in warnings[0]


def test_errors_of_rl_zoo3_propagate(site):
    write(site, "rl_zoo3/utils.py", "raise RuntimeError('its own')\n")
    code = "try:\n import rl_zoo3.utils\nexcept RuntimeError as error:\n print(error)"
    out, err = run(site, "-c", INSTALL + code)
    assert out == ["its own"]
    assert not err


@pytest.mark.parametrize(("value", "plugged"), [("1", 0), ("0", 3), ("", 3)])
def test_off_switch(site, value, plugged):
    out, _ = run(site, "-c", INSTALL + ALL_TARGETS, SB3_FLOWPOLICY_NO_ZOO_HOOK=value)
    assert sum("plugged" in line for line in out) == plugged


def test_starting_python_imports_the_hook_and_nothing_else(site, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    write(other, "other.pth", "import sys\n")
    code = (
        # Reading .pth files imports modules of its own.
        f"import sys, site; site.addsitedir({str(other)!r}); before = set(sys.modules)\n"
        f"site.addsitedir({str(site)!r})\n"
        "print(sorted(set(sys.modules) - before))"
    )
    out, err = run(site, "-c", code)
    assert out == ["['_sb3_flowpolicy_hook']"]
    assert not err


def test_the_start_up_line_survives_without_the_hook(site):
    (site / "_sb3_flowpolicy_hook.py").unlink()
    _, err = run(site, "-c", f"import site; site.addsitedir({str(site)!r})")
    assert not err
