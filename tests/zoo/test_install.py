"""The wheel, in an environment of its own: rl_zoo3's commands as typed, from an empty folder.

Takes about a minute, most of it for importing torch again and again.
"""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("build")
pytest.importorskip("hatchling")

ROOT = Path(__file__).parents[2]
ENV = ("--env", "TunnelDiagonal-v0")
# Updates start early and are few; evaluation is over in a moment.
BRIEF = (*ENV, "-n", "300", "--eval-freq", "200", "--eval-episodes", "1")
EARLY = ("-params", "learning_starts:250", "random_steps:250")


def call(*command, cwd, **environment):
    """Run a command without this process's import path; return what it printed."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


class Environment:
    """A virtual environment with the wheel in it, and an empty folder to work in."""

    def __init__(self, folder):
        venv.create(folder / "venv", symlinks=os.name != "nt")
        self.python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
        self.work = folder / "work"
        self.work.mkdir()
        self.site = Path(self("-c", "import sysconfig; print(sysconfig.get_path('purelib'))")[0])
        self.dependencies = self.site / "dependencies.pth"

    def __call__(self, *arguments, **environment):
        return call(self.python, *arguments, cwd=self.work, **environment).splitlines()

    def pip(self, *arguments):
        call(sys.executable, "-m", "pip", "--python", self.python, *arguments, cwd=self.work)

    def install(self, wheel):
        self.pip("install", "--no-deps", "--no-index", wheel)

    def lend_dependencies(self):
        """Let the environment see what ours has, except for our editable install.

        A folder that is named in a `.pth` file goes on the path, but the `.pth` files in it are
        not read. The editable install consists of one.
        """
        ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
        self.dependencies.write_text("\n".join(sorted(ours)))

    def files(self):
        return {path.relative_to(self.site) for path in self.site.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    build = ("-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT)
    call(sys.executable, *build, cwd=folder)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    environment = Environment(tmp_path_factory.mktemp("installed"))
    environment.install(wheel)
    environment.lend_dependencies()
    return environment


def zoo(environment, script, *arguments):
    # Threads only get in each other's way in networks this small, above all beside other tests.
    return "\n".join(environment("-m", f"rl_zoo3.{script}", *arguments, OMP_NUM_THREADS="1"))


def test_contents_of_the_wheel(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {
        "sb3_flowpolicy",
        "flowpolicy_envs",
        "zoo_hyperparams",
        "_sb3_flowpolicy_hook.py",
        "_sb3_flowpolicy_hook.pth",
    }
    assert {
        "sb3_flowpolicy/py.typed",
        "flowpolicy_envs/py.typed",
        "zoo_hyperparams/sac_flow.yml",
        "zoo_hyperparams/sac_lowrank.yml",
        "zoo_hyperparams/sac_gauss.yml",
    } <= names


def test_starting_python_imports_nothing_heavy(installed):
    loaded = installed("-c", "import sys; print(*sys.modules, sep='\\n')")
    assert "_sb3_flowpolicy_hook" in loaded
    packages = {name.partition(".")[0] for name in loaded}
    assert not packages & {
        *("torch", "numpy", "gymnasium", "stable_baselines3", "rl_zoo3"),
        *("sb3_flowpolicy", "flowpolicy_envs", "importlib", "pathlib", "typing"),
    }


def test_train_then_enjoy_then_record_video(installed):
    shown = zoo(installed, "train", "--algo", "sac_flow", *BRIEF, *EARLY)
    assert str(installed.site / "zoo_hyperparams" / "sac_flow.yml") in shown
    logs = ("-f", "logs", "--algo", "sac_flow", *ENV)
    assert "Success rate" in zoo(installed, "enjoy", *logs, "-n", "80", "--no-render")
    zoo(installed, "record_video", *logs, "-n", "5")
    assert list((installed.work / "logs").rglob("*.mp4"))


def test_optimize_then_train_with_a_trial_and_a_file_of_ones_own(installed):
    study = ("--storage", "study.log", "--study-name", "ranks")
    tune = ("--optimize", "--n-trials", "2", "--no-optim-plots")
    quick = ("--n-evaluations", "1", *BRIEF, *EARLY)
    shown = zoo(installed, "train", "--algo", "sac_lowrank", *tune, *study, *quick)
    assert "Number of finished trials:  2" in shown
    mine = installed.work / "mine.yml"
    settings = "policy: LowRankPolicy, n_timesteps: 20, target_update_interval: 3"
    mine.write_text(f"default: {{{settings}}}\n")
    chosen = (*ENV, "--eval-freq", "-1", "--trial-id", "1", *study, "-conf", "mine.yml")
    shown = zoo(installed, "train", "--algo", "sac_lowrank", *chosen)
    assert "Loading hyperparameters from: mine.yml" in shown
    assert "('target_update_interval', 3)" in shown
    assert "'rank': " in shown
    assert "'weight_decay': 2.5e-05" in shown


def test_launcher_without_the_hook(installed):
    launch = ("-m", "sb3_flowpolicy.zoo.train", "--help")
    assert "sac_lowrank" in "\n".join(installed(*launch, SB3_FLOWPOLICY_NO_ZOO_HOOK="1"))


def test_uninstalling_leaves_nothing_behind(wheel, tmp_path):
    environment = Environment(tmp_path)
    before = environment.files()
    environment.install(wheel)
    assert environment.files() > before
    environment.pip("uninstall", "--yes", "sb3_flowpolicy")
    assert environment.files() == before


def test_editable_install_has_the_hook(tmp_path):
    pytest.importorskip("editables")
    build = f"import hatchling.build as backend; print(backend.build_editable({str(tmp_path)!r}))"
    name = call(sys.executable, "-c", build, cwd=ROOT).strip()
    environment = Environment(tmp_path)
    environment.install(tmp_path / name)
    environment.lend_dependencies()
    show = "print('sac_flow' in rl_zoo3.ALGOS, *zoo_hyperparams.__path__)"
    shown = environment("-c", f"import rl_zoo3, zoo_hyperparams; {show}")
    assert shown == [f"True {ROOT / 'zoo_hyperparams'}"]
    with pytest.raises(AssertionError, match="No module named 'tests'"):
        environment("-c", "import tests")
