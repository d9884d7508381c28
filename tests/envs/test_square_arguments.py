import pytest

from flowpolicy_envs import FindGoal, Hold, Move, SquareEnv, SquareVectorEnv

NAN = float("nan")

BAD = [
    ({"task": "juggle"}, r"task must be a Task, one of .*'hold', .*, got 'juggle'"),
    ({"task": {"angle": 1.0}}, r"or a mapping with such a name, got {'angle': 1.0}"),
    ({"task": {"name": "move", "angle": -1.0}}, "angle must"),
    ({"mass": 0.0}, r"mass must be positive, got 0.0"),
    ({"mass": [0.3, 0.2]}, r"mass must be a finite number or \[low, high\], got \[0.3, 0.2\]"),
    ({"mass": [0.1, 0.2, 0.3]}, r"mass must be a finite number or \[low, high\]"),
    ({"mass": "heavy"}, r"mass must be a number or \[low, high\], got 'heavy'"),
    ({"mass": NAN}, r"mass must be a finite number or \[low, high\], got nan"),
    ({"size": -0.6}, r"size must be positive, got -0.6"),
    ({"friction": -0.1}, r"friction must be at least 0, got -0.1"),
    ({"finger_damping": 0.0}, r"finger_damping must be positive, got 0.0"),
    ({"finger_noise": -1.0}, r"finger_noise must be finite and at least 0, got -1.0"),
    ({"warm_up": NAN}, r"warm_up must be finite and at least 0, got nan"),
    ({"dt": 0.0}, r"dt must be at least 1e-6 s, got 0.0"),
    ({"dt": 1e-320}, r"dt must be at least 1e-6 s, got 1e-320"),
    ({"friction_cone": "false"}, r"friction_cone must be True or False, got 'false'"),
    ({"substeps": 2.5}, r"substeps must be an integer of at least 1, got 2.5"),
    ({"stack": 0}, r"stack must be an integer of at least 1, got 0"),
    ({"observe": []}, r"observe must name some of .*, got \[\]"),
    ({"observe": ["velocity"]}, r"observe must name some of .*'position'.*, got \['velocity'\]"),
    ({"observation_noise": -0.1}, r"observation_noise must be finite and at least 0, got -0.1"),
    ({"observation_noise": {"mass": 1}}, r"observation_noise must be for .*, got 'mass'"),
    ({"kp": 100.0}, r"dt \* kp / \(kd \+ finger_damping\) must be at most 1 .*, got 2"),
    ({"mass": 0.05}, r"must be at most 0.5 for the contact forces to converge, got 0.55"),
    ({"max_force": 12.0}, r"must be at most max_speed"),
    ({"render_mode": "ansi"}, r"render_mode must be None or one of .*, got 'ansi'"),
    ({"render_size": 8}, r"render_size must be an integer of at least 16, got 8"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_errors_name_argument_expectation_and_value(arguments, message):
    with pytest.raises(ValueError, match=message):
        SquareEnv(**arguments)
    if arguments.get("render_mode") != "ansi":
        with pytest.raises(ValueError, match=message):
            SquareVectorEnv(2, **arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Hold(held=-1.0), "held must be finite and at least 0, got -1.0"),
        (lambda: Hold(safe_reach=1.0), "safe_reach must be less than 1, got 1.0"),
        (lambda: Move(effort=NAN), "effort must be finite and at least 0, got nan"),
        (lambda: FindGoal(radius=0.0), "radius must be positive, got 0.0"),
        (lambda: FindGoal(span=1.5), "span must be at most 1, got 1.5"),
    ],
)
def test_tasks_check_their_coefficients(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_finer_step_makes_stiffer_constants_possible():
    assert SquareEnv(kp=100.0, mass=0.05, max_force=12.0, dt=0.002, substeps=125)
