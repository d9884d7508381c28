"""A mutated bundle is refused with BundleError, or loads as the content that it has.

``pytest -m slow tests/bundle`` tries 10 000 of them, and prints the counts with ``-s``.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_flowpolicy import BundleError, SACFlow
from tests.bundle.conftest import content_of, make_model, parts_of, sealed
from tests.bundle.mutations import HOSTILE, KNOWING, by_chance
from tests.fuzz.effort import fuzz


def outcome(content: bytes, path: Path) -> str:
    """Load and save again: a file that is accepted must be saved with the same content."""
    path.write_bytes(content)
    try:
        model = SACFlow.load_safe(path, device="cpu")
    except BundleError as refusal:
        error = str(refusal)
    else:
        error = ""
    if error:
        assert str(path) in error
        return "refused"
    again = model.save_safe(path.with_name("again.safetensors"))
    assert content_of(again) == content_of(path)
    return "loaded"


def assert_refused_or_equal(content: bytes, path: Path, original: Path) -> None:
    if outcome(content, path) == "loaded":
        assert content_of(path) == content_of(original)


def test_the_original_is_loaded(bundle: Path, tmp_path: Path) -> None:
    assert outcome(bundle.read_bytes(), tmp_path / "same") == "loaded"


@fuzz(200)
@given(seed=st.integers(0, 2**32))
def test_damaged_files_are_refused_or_equal_in_content(bundle: Path, seed: int) -> None:
    spoiled = by_chance(bundle.read_bytes(), np.random.default_rng(seed))
    assert_refused_or_equal(spoiled, bundle.with_name("spoiled.safetensors"), bundle)


def test_every_single_byte_counts(bundle: Path, tmp_path: Path) -> None:
    content = bundle.read_bytes()
    path = tmp_path / "spoiled.safetensors"
    length = int.from_bytes(content[:8], "little")
    rng = np.random.default_rng(0)
    for place in range(0, 8 + length, 97):
        raw = bytearray(content)
        raw[place] ^= 1 << int(rng.integers(8))
        assert_refused_or_equal(bytes(raw), path, bundle)  # JSON says some things in two ways
    for place in rng.integers(8 + length, len(content), 100):
        raw = bytearray(content)
        raw[place] ^= 1 << int(rng.integers(8))
        assert outcome(bytes(raw), path) == "refused", place
    for cut in (*range(0, 200), *rng.integers(0, len(content), 50)):
        assert outcome(content[:cut], path) == "refused", cut


@fuzz(200)
@given(seed=st.integers(0, 2**32), spoil=st.sampled_from(KNOWING))
def test_forged_bundles_are_refused_or_kept_as_they_are(bundle: Path, seed: int, spoil) -> None:
    try:
        spoiled = spoil(bundle.read_bytes(), np.random.default_rng(seed))
    except UnicodeEncodeError:
        return
    outcome(spoiled, bundle.with_name("spoiled.safetensors"))


@fuzz(120)
@given(
    value=st.recursive(
        st.one_of(st.sampled_from(HOSTILE), st.integers(), st.floats(allow_nan=False), st.text()),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
        max_leaves=4,
    ),
    key=st.sampled_from(
        [
            *("settings.gamma", "settings.seed", "settings.train_freq", "settings.ent_coef"),
            *("settings.learning_rate", "settings.buffer_size", "settings.random_steps"),
            *("policy.net_arch", "policy.distribution_kwargs", "policy.policy_class"),
            *("policy.distribution", "policy.optimizer_kwargs", "replay_buffer", "policy"),
            *("policy.n_critics", "policy.activation_fn", "observation_space"),
            *("action_space", "optimizers.actor", "normalization", "normalization.clip_obs"),
            *("progress.num_timesteps", "made_with.torch", "format", "replay_buffer.kwargs"),
        ]
    ),
)
def test_any_value_of_a_setting_is_refused_or_kept(bundle: Path, key: str, value) -> None:
    header, config, data = parts_of(bundle.read_bytes())
    parent = config
    *path, last = key.split(".")
    for step in path:
        parent = parent[step]
    parent[last] = value
    outcome(sealed(header, config, data), bundle.with_name("spoiled.safetensors"))


@pytest.mark.slow
def test_ten_thousand_spoiled_bundles(bundle: Path, tmp_path: Path) -> None:
    content, path = bundle.read_bytes(), tmp_path / "spoiled.safetensors"
    tally: Counter[str] = Counter()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(10_000):
        rng = np.random.default_rng(seed)
        spoil = by_chance if seed % 2 else KNOWING[seed // 2 % len(KNOWING)]
        spoiled = spoil(content, rng)
        tally[f"{spoil.__name__} {outcome(spoiled, path)}"] += 1
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"\n{sum(tally.values())} bundles, {grown / 1024:.1f} MiB more at the peak")
    for what, count in sorted(tally.items()):
        print(f"  {what:<28}{count:>6}")
    assert tally["by_chance loaded"] < 50  # the few that do not change the content


MEMORY = """
import resource, sys
from sb3_flowpolicy import BundleError, SACFlow
small, absurd, big = sys.argv[1:]
SACFlow.load_safe(small, device="cpu").predict([0.0, 0.0, 0.0])
for path in (absurd, big):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        SACFlow.load_safe(path, device="cpu")
        print("loaded")
    except BundleError:
        print("refused")
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


def test_memory_stays_below_twice_the_file(bundle: Path, tmp_path: Path) -> None:
    model = make_model(policy_kwargs={"net_arch": [700, 700]})
    for network in (model.actor, model.critic):
        for parameter in network.parameters():
            parameter.grad = th.zeros_like(parameter)
        network.optimizer.step()  # creates the moments
    big = model.save_safe(tmp_path / "big")
    header, config, data = parts_of(big.read_bytes())
    config["policy"]["net_arch"] = [10**9, 10**9]
    absurd = tmp_path / "absurd.safetensors"
    absurd.write_bytes(sealed(header, config, data))
    command = [sys.executable, "-c", MEMORY, str(bundle), str(absurd), str(big)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert out[::2] == ["refused", "loaded"]
    assert max(int(grown) for grown in out[1::2]) < 2 * big.stat().st_size
