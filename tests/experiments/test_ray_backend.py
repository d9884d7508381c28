"""The same items on a Ray cluster, one machine of which dies."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.runner import Progress, results_folder, run_local, unfinished
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import make_plan

ray = pytest.importorskip("ray")


@pytest.mark.slow
def test_no_seed_is_lost_with_a_node(tiny: Experiment, tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    from sb3_flowpolicy.experiments.ray_backend import run_on_ray

    plan = make_plan(tiny, seeds=4, seeds_per_item=1, steps=300)
    assert len(plan.items) == 8
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        doomed = cluster.add_node(num_cpus=1)
        cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        ray.init(address=cluster.address, log_to_driver=False)
        seen: list[str] = []
        killed: list[str] = []

        class Watch(Progress):
            def note(self, key: str, steps: int) -> None:
                seen.append(key)
                super().note(key, steps)

        def kill_in_the_middle() -> None:
            # Two items have begun, one on either node.
            while len(set(seen)) < 2:
                time.sleep(0.05)
            cluster.remove_node(doomed, allow_graceful=False)
            killed.extend(set(seen))

        killer = threading.Thread(target=kill_in_the_middle, daemon=True)
        with (
            results_folder(tmp_path / "ray", plan) as folder,
            Watch(plan.items, shown=False) as progress,
        ):
            killer.start()
            run_on_ray(folder, unfinished(folder, plan), progress)
            killer.join(timeout=60)
            assert killed
            assert len(set(killed)) < len(plan.items)
            assert not unfinished(folder, plan)
    finally:
        ray.shutdown()
        cluster.shutdown()
    with (
        results_folder(tmp_path / "local", plan) as local,
        Progress(plan.items, shown=False) as progress,
    ):
        run_local(local, plan.items, progress, workers=2)
    for item in plan.items:
        ours, theirs = ItemFiles(local, item.key), ItemFiles(folder, item.key)
        assert theirs.read_table().equals(ours.read_table())
        assert theirs.read_details() == ours.read_details()
