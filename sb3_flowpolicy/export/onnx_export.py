"""Export a policy to ONNX, including observation normalization and action scaling."""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy.bundle import normalization
from sb3_flowpolicy.bundle.model import made_with
from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.export.deployed import DeployedPolicy, expected_actions, random_inputs
from sb3_flowpolicy.policies import FlowActor

FORMAT = "sb3_flowpolicy.onnx.1"
#: Largest accepted difference to ``predict``, relative to the range of the actions.
TOLERANCE = 1e-5


def export_onnx(
    model: OffPolicyAlgorithm,
    path: str | Path,
    *,
    stochastic: bool = False,
    vec_normalize: VecNormalize | None = None,
) -> Path:
    """Write a policy as an ONNX file that needs neither torch nor this package to run.

    The graph takes raw observations of the environment and returns actions in its units, both
    with a leading batch axis: normalization and clipping of ``VecNormalize``, the policy, tanh and
    rescaling are included. Before the file is written, onnxruntime runs it, and its actions are
    compared with those of ``predict``.

    Args:
        model: ``SACFlow``, ``TQCFlow``, ``CrossQFlow``, or a stock one with one of our policies.
        path: File to write, ``.onnx`` if it has no suffix.
        stochastic: Whether to sample as well: with a further input ``noise`` of independent
            standard normals, (batch, M), and a further output ``sampled_action``.
        vec_normalize: Statistics to include. Default: those of the model's environment, or of
            the bundle that it was loaded from.

    Returns:
        The file's path.

    Raises:
        ValueError: If the policy is not one of ours, explores with gSDE, or has another
            ``deterministic_mode`` than ``"base"``.
        ModuleNotFoundError: If the extra ``[export]`` is not installed.
        RuntimeError: If the file's actions differ from the model's.

    Example:
        >>> import tempfile
        >>> from sb3_flowpolicy import SACFlow
        >>> model = SACFlow("FlowPolicy", "Pendulum-v1")
        >>> path = export_onnx(model, tempfile.mkdtemp() + "/pendulum")
        >>> import numpy as np
        >>> import onnxruntime
        >>> session = onnxruntime.InferenceSession(path)
        >>> (action,) = session.run(["action"], {"obs": np.zeros((5, 3), np.float32)})
        >>> action.shape
        (5, 1)
    """
    policy: Any = model.policy
    actor, mode = getattr(policy, "actor", None), getattr(policy, "deterministic_mode", None)
    if mode != "base" or not isinstance(actor, FlowActor):
        raise ValueError(
            'model must have a policy of sb3_flowpolicy with deterministic_mode="base" and '
            f"use_sde=False, got {type(policy).__name__} with deterministic_mode={mode!r} and an "
            f"actor of type {type(actor).__name__}"
        )
    statistics = normalization.of_model(model, vec_normalize)
    deployed = DeployedPolicy(policy, statistics, stochastic).cpu().eval()
    inputs = random_inputs(policy, stochastic)
    proto = _translate(deployed, [th.from_numpy(array[:2]) for array in inputs])
    _add_metadata(proto, model, statistics is not None, stochastic)
    content = proto.SerializeToString()
    _check(content, deployed, inputs, expected_actions(policy, statistics, stochastic, inputs))
    path = Path(path)
    path = path if path.suffix else path.with_suffix(".onnx")
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        draft.write_bytes(content)
    return path


def _translate(deployed: DeployedPolicy, example: list[th.Tensor]) -> Any:
    batch = th.export.Dim("batch", min=1)
    with _quietly():
        program = th.onnx.export(
            deployed,
            tuple(example),
            input_names=deployed.inputs,
            output_names=deployed.outputs,
            dynamic_shapes={"inputs": tuple({0: batch} for _ in example)},
            dynamo=True,
            external_data=False,
            verbose=False,  # prints its progress
        )
    assert program is not None
    proto = program.model_proto
    # Remove the source of each operation: paths of this machine, and half of the file.
    graph = proto.graph
    for part in (*graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    graph.ClearField("doc_string")
    return proto


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Silence the exporter's warnings about torch's own code and missing packages."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logger = logging.getLogger("torch.onnx")
        level = logger.level
        logger.setLevel("ERROR")
        try:
            yield
        finally:
            logger.setLevel(level)


def _add_metadata(
    proto: Any, model: OffPolicyAlgorithm, normalized: bool, stochastic: bool
) -> None:
    """Describe inputs, outputs and origin for users who have only the file."""
    policy: Any = model.policy
    facts: dict[str, Any] = {
        "format": FORMAT,
        "policy": type(policy).__name__,
        "distribution": policy.distribution,
        "num_timesteps": model.num_timesteps,
        "observation_space": describe_space(model.observation_space),
        "action_space": describe_space(model.action_space),
        "vec_normalize": "inside" if normalized else "none",
        "made_with": made_with(),
    }
    if stochastic:
        facts["noise"] = {
            "input": "noise",
            "shape": ["batch", policy.actor.density.noise_dim],
            "draw": "independent standard normals, new ones for each action",
        }
    for key, value in facts.items():
        entry = proto.metadata_props.add()
        entry.key, entry.value = key, value if isinstance(value, str) else json.dumps(value)


def describe_space(space: spaces.Space) -> dict[str, Any]:
    """Describe a space in JSON; bounds that are all equal become one number.

    Example:
        >>> describe_space(spaces.Box(-1, 1, (2,)))
        {'type': 'Box', 'dtype': 'float32', 'shape': [2], 'low': -1.0, 'high': 1.0}
    """
    if isinstance(space, spaces.Dict):
        entries = {key: describe_space(part) for key, part in space.spaces.items()}
        return {"type": "Dict", "spaces": entries}
    facts: dict[str, Any] = {
        "type": type(space).__name__,
        "dtype": str(space.dtype),
        "shape": list(space.shape or ()),
    }
    for name in ("low", "high", "n", "nvec"):
        if name in vars(space):
            values = np.asarray(getattr(space, name))
            # JSON has no infinity.
            words = np.where(np.isfinite(values), values.astype(object), values.astype(str))
            facts[name] = words.flat[0] if np.unique(values).size == 1 else words.tolist()
    return facts


def _check(
    content: bytes,
    deployed: DeployedPolicy,
    inputs: list[np.ndarray],
    expected: list[np.ndarray],
) -> None:
    """Raise ``RuntimeError`` if the file's actions differ, at several batch sizes."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    span = deployed.get_buffer("span").numpy().max()
    for n in (1, len(inputs[0])):
        feed = dict(zip(deployed.inputs, (array[:n] for array in inputs), strict=True))
        for name, got, wanted in zip(
            deployed.outputs, session.run(None, feed), expected, strict=True
        ):
            gap = np.abs(got - wanted[:n]).max()
            if not gap <= TOLERANCE * max(1.0, span):
                raise RuntimeError(
                    f"{name} of the ONNX file must equal the model's to {TOLERANCE:g} of the "
                    f"actions' range, got a difference of {gap:.3g}"
                )
