"""What is recorded about the machine."""

from __future__ import annotations

import json

from sb3_flowpolicy.common.machine import PACKAGES, machine


def test_machine_has_what_a_reader_needs() -> None:
    facts = machine()
    assert set(facts) == {
        *("date", "platform", "processor", "cpu_count", "load_average", "threads", "python"),
        *("versions", "commit"),
    }
    assert facts["threads"] == 1
    assert set(facts["versions"]) == set(PACKAGES)
    assert facts["versions"]["torch"]
    assert json.loads(json.dumps(facts)) == facts
