"""Claims E2 to E6 (thesis 3.2, the Tunnel), and an experiment of ours."""

from __future__ import annotations

from sb3_flowpolicy.experiments import checks
from sb3_flowpolicy.experiments.experiment import (
    AGENTS,
    FLOW,
    FLOW_DEFAULT_INIT,
    GAUSS,
    LOW_RANK,
    Experiment,
    Setting,
)

LEARNED = {"ent_coef": "auto"}
DIMENSIONS = (2, 4, 8, 16, 32)

_SPARSE = (
    Setting("horizontal", "TunnelHorizontal-v0"),
    Setting("diagonal", "TunnelDiagonal-v0"),
)
_HORIZONTAL_ALIKE = tuple(checks.solved("horizontal", agent, 0.9, at_best=True) for agent in AGENTS)

TUNNEL_CLAIMS = (
    Experiment(
        name="circle-fixed-alpha",
        claim="E2",
        source="section 3.2.2, figures 3.4 to 3.6",
        title="Circle with dense reward, fixed entropy coefficient: does the entropy collapse?",
        thesis="All agents end with about the same return. Gauss takes longer and gives up much "
        "more entropy; NF keeps more than LR. One of five NF seeds learned nothing.",
        settings=(Setting("circle", "TunnelCircle-v1"),),
        agents=(*AGENTS, FLOW_DEFAULT_INIT),
        checks=(
            checks.about_equal("circle", "test_return", AGENTS, 0.1),
            checks.ordered("circle", "entropy", (FLOW, LOW_RANK, GAUSS)),
            checks.slower("circle", GAUSS, (LOW_RANK, FLOW)),
            checks.none_fails("circle", FLOW),
        ),
        measures=("profile",),
        pictures_at=(0.1, 0.25, 1.0),
        notes="The thesis's flow started from torch's default weights; ours starts as a standard "
        "normal. The fourth agent starts as the thesis's did, to count the seeds that fail. The "
        "thesis does not say what progress earns. One scale serves this experiment and the next "
        "two (version 1 of the circles); tuning seeds showed how it affects each line of their "
        "rules (docs/environments/tunnel.md). There, Gauss needed more steps than NF only at "
        "scales at which it never learned.",
    ),
    Experiment(
        name="circle-fixed-entropy",
        claim="E3",
        source="section 3.2.3, figures 3.7 and 3.8",
        title="Circle with dense reward, learned entropy coefficient: entropy along the way",
        thesis="With exploration NF collects about twice Gauss's return, without it they are "
        "equal. Gauss meets the entropy target on the first steps, where it costs least.",
        settings=(Setting("circle", "TunnelCircle-v1", overrides=LEARNED),),
        checks=(
            checks.at_least_times("circle", "train_return", FLOW, GAUSS, 1.5),
            checks.about_equal("circle", "test_return", (FLOW, GAUSS), 0.1),
            checks.front_loads("circle", GAUSS, FLOW, 0.5),
            checks.none_fails("circle", FLOW),
        ),
        measures=("profile",),
        pictures_at=(1.0,),
        notes="The target is minus the dimension of the action space. 'About twice' is taken to be "
        "at least 1.5 times. The ratio of the returns depends on what progress earns beside the "
        "goal: on version 0 of the circle the way alone earned 1.36, and NF collected 1.33 times "
        "as much as Gauss although it succeeded three times as often. The line on the entropy at "
        "the start replaced one that compared the first third of the way with the last, before "
        "the seeds of version 1 ran. The profiles of version 0 had followed the longer way around "
        "the circle, which no agent takes.",
    ),
    Experiment(
        name="circle-narrow",
        claim="E4",
        source="section 3.2.3, figure 3.9",
        title="Narrower circle, larger final reward, learned entropy coefficient: oscillations",
        thesis="Once Gauss has found the goal, its return, entropy and entropy coefficient swing "
        "up and down together, in every seed; those of NF and LR do not.",
        settings=(Setting("narrow", "TunnelCircleNarrow-v1"),),
        checks=(
            checks.oscillates("narrow", GAUSS, 1.0),
            checks.is_steady("narrow", LOW_RANK, 0.0),
            checks.is_steady("narrow", FLOW, 0.0),
        ),
        steps=120_000,
        eval_every=500,
        measures=("profile",),
        pictures_at=(1.0,),
        notes="The thesis raises the goal's reward from 0.1 to 1, as here, and does not say what "
        "progress earns. On version 0 of the circle, where the whole way earned 1.36, none of "
        "three tuning seeds of Gauss swung at a goal of 1. At a goal of 10, half of ten seeds of "
        "Gauss and half of those of LR did. "
        "Seeds that never reach the goal in training cannot oscillate, so steadiness requires "
        "that most seeds learn. Training is twice as long as in the two experiments before: on "
        "tuning seeds Gauss first reached the goal after 31 000 to 36 000 steps, and one of two "
        "seeds began to swing after 50 000.",
    ),
    Experiment(
        name="sparse-fixed-alpha",
        claim="E5",
        source="section 3.2.4, figures 3.2 and 3.10",
        title="Straight tunnel with sparse reward, fixed entropy coefficient: axis and diagonal",
        thesis="Along an axis the agents do not differ, and all lose what they learned later on, "
        "as the entropy coefficient is a little too high. Diagonally Gauss fails; NF beats LR.",
        settings=_SPARSE,
        checks=(
            *_HORIZONTAL_ALIKE,
            checks.about_equal("horizontal", "train_return", AGENTS, 0.1),
            checks.mostly_fails("diagonal", GAUSS, 0.3),
            checks.solved("diagonal", LOW_RANK, 0.9),
            checks.solved("diagonal", FLOW, 0.9),
            checks.ordered("diagonal", "train_return", (FLOW, LOW_RANK)),
        ),
        pictures_at=(1.0,),
        notes="Networks of two layers with 16 units (NF: 4), as in the thesis. Not reproduced: "
        "here LR is as good as NF on the diagonal, as both solve it in every seed, and no agent "
        "loses along the axis what it has learned (which is not part of the rule, as it does not "
        "distinguish the agents). The lines on equal returns along the axis and on NF above LR "
        "were added after the runs; both are claims of the thesis. With two and four times the "
        "entropy coefficient, three tuning seeds of Gauss (100 to 102) stay almost uniform along "
        "the axis: they learn nothing that they could lose.",
    ),
    Experiment(
        name="sparse-fixed-entropy",
        claim="E6",
        source="section 3.2.4, figure 3.11",
        title="Straight tunnel with sparse reward, learned entropy coefficient",
        thesis="The same picture, all agents a little worse than with the fixed coefficient. Gauss "
        "finds the diagonal goal now and then.",
        settings=tuple(Setting(s.name, s.env_id, overrides=LEARNED) for s in _SPARSE),
        checks=(
            *_HORIZONTAL_ALIKE,
            checks.about_equal("horizontal", "train_return", AGENTS, 0.1),
            checks.mostly_fails("diagonal", GAUSS, 0.3),
            checks.ordered("diagonal", "train_success", (FLOW, GAUSS), 0.2),
            checks.ordered("diagonal", "train_success", (LOW_RANK, GAUSS), 0.2),
            checks.no_better_than("sparse-fixed-alpha", "diagonal", (LOW_RANK, FLOW)),
        ),
        pictures_at=(1.0,),
        notes="An entropy of -2 nats is too high for a tunnel of this width: every agent fails "
        "most training episodes, so their training successes differ by less than the rule "
        "requires. Along the axis, the image of the flow's base mean is not a good action at that "
        'entropy: with `deterministic_mode="log_prob"` ten of ten other seeds solve it '
        "(docs/guide/deterministic.md). The target is the thesis's and was not changed. The line "
        "on equal returns along the axis was added after the runs, as in sparse-fixed-alpha.",
    ),
    Experiment(
        name="diagonal-dimensions",
        claim="D2-32",
        source="ours",
        title="The diagonal tunnel in 2 to 32 dimensions: up to which one does each agent learn?",
        thesis="Not in the thesis. The share of directions that stay in the tunnel shrinks with "
        "every dimension, for independent noise much faster than for correlated noise.",
        settings=tuple(
            Setting(
                f"{count}-dimensions",
                "TunnelDiagonal-v0",
                env_kwargs={"total_dims": count, "coupled_dims": count},
            )
            for count in DIMENSIONS
        ),
        checks=tuple(
            checks.solved(f"{count}-dimensions", agent, 0.9)
            for count in DIMENSIONS
            for agent in (LOW_RANK, FLOW)
        ),
        notes="Everything but the number of dimensions is as in sparse-fixed-alpha, including the "
        "tunnel's width. There is no claim to reproduce: each line states whether that agent still "
        "solves the task. Of independent uniform actions 8.6 % stay inside with two dimensions, "
        "0.02 % with four, and fewer than one in 400 000 with eight: a correlation cannot be "
        "learned from steps that never happen. In diagonal-widened the tunnel becomes wider with "
        "the number of dimensions.",
    ),
)
