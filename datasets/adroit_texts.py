"""What the cards of the Adroit datasets say, with places for the numbers that `build_adroit.py` fills in."""

ABOUT = {
    "pen": "a hand turns a pen in the air until it points as a second pen does (24 joints driven, 45 features)",
    "door": "a hand on an arm undoes a latch and pulls a door open (28 joints driven, 39 features)",
    "hammer": "a hand on an arm picks up a hammer and drives a nail in (26 joints driven, 46 features)",
    "relocate": "a hand on an arm picks up a ball and holds it at a marked place (30 joints driven, 39 features)",
}

HUMAN_DOOR = (
    "The 25 demonstrations that people gave with a data glove in virtual reality (Rajeswaran et al. 2018): Minari's "
    "`D4RL/door/human-v2` where it is installed, else converted from the file that hand_dapg published. That file has "
    'no observation after the last action, so 6,729 rows give 6,704 steps; `infos["raw_action"]` keeps the actions '
    "as recorded, beyond [-1, 1] in places. The rewards are the recorded ones: computed from the observations they "
    "are D4RL's to 0.0010 on average (what is left is the cost of velocities, which are not observed), and 0.027 off "
    "with the installed environment's sign. Only 8% of the demonstrations start where the environment resets."
)
HUMAN_OTHER = (
    "Minari's `D4RL/{task}/human-v2`, where it is installed (`minari download D4RL/{task}/human-v2`). It was not "
    "within reach where this card was made, so it is not in the table."
)

CLONES_DOOR = (
    "- Policies cloned from the 25 human demonstrations never open the door: the roll-outs in adroit-door-cloned are\n"
    "  failures (returns of about -55). Those cloned from expert roll-outs succeed part of the time."
)
CLONES_OTHER = "- A policy cloned from expert roll-outs succeeds part of the time, and so do the roll-outs here."

REMARKS = {
    "hammer": (
        "\nhammer_dapg_2 drives the nail in where the board hangs at 0.15 m or higher and not where it hangs lower. "
        "Resets\ndraw 0.10 to 0.25 m, so that its mean depends on the heights drawn: 100 resets in a row from one seed "
        "gave 7,893.\n"
    )
}

CARD = """# adroit-{task}

Data, target policies and true values for Adroit {task} (Rajeswaran et al. 2018): {about}, in gymnasium-robotics.
This card belongs to four datasets, which differ in how much people took part; the paper evaluates the first three.

```python
from oat_gym import domains

data = domains.load("adroit-{task}-expert")  # or human, cloned, cloned-from-expert: a minari.MinariDataset
policies = domains.policies("adroit-{task}")  # DOPE's 11 target policies
truth = domains.truth("adroit-{task}", gamma=0.995)
```

- **adroit-{task}-human**: {human}
- **adroit-{task}-cloned**: D4RL's recipe: half demonstrations, half roll-outs of a policy cloned from all of them.
  Whole demonstrations, in order, as many as fit into half the steps.
- **adroit-{task}-expert**: roll-outs of the DAPG expert of hand_dapg, which samples its actions.
- **adroit-{task}-cloned-from-expert**: as `cloned`, with the expert's roll-outs for demonstrations. No person
  took part.

![Trajectories of each dataset](trajectories.png)

One line an episode: {drawn}. In colour, where it was mined: the sub-trajectories of the best-supported PST set,
and what OAT puts in their place.

## What is in them

| dataset | episodes, steps | lengths | return: mean (range) | success | on a bound | support of the best PST set |
|---|---|---|---|---|---|---|
{rows}

- `success`: share of the episodes that reach the goal at some step. `on a bound`: share of action entries at -1 or 1.
  Support: number of episodes that contain the best temporally discrete sub-sequence of W = 20 steps, by OAT's defaults.
- Size: {steps} steps, those of D4RL's human data, as in the paper. The last episode is cut where that is reached.
- Rewards are D4RL's. The installed environment's, in `infos["stock_reward"]`, *add* 0.1 times the distance from hand to
  object where D4RL subtracts it (door, hammer, relocate; gymnasium-robotics since 1.2.1, mended in `-v2`).
  Which of the two Minari's own D4RL data carries was not known when this was written: `domains.load` tells it for door
  and relocate, and converts the environment's into D4RL's.
- Episodes never terminate: the environment has no terminal states (D4RL's pen ends an episode when the pen drops).
- Actions are recorded as clipped to [-1, 1], as the environment clips them (and D4RL's own data does).
  `infos["log_prob"]` (expert, cloned-from-expert) is the log-probability of the *clipped* action: an entry on a bound
  has the probability that clipping puts there. The target policies' `log_prob` is of the same kind.
- A roll-out's `seed` metadata resets the environment to its start, from which its actions replay it exactly (the
  demonstrations in cloned data have none).
{clones}

## True values

{episodes} episodes of at most {horizon} steps a policy, the same resets for all; +- one standard error. {note}
DOPE's returns are the published ones; the difference is in standard errors, DOPE's taken as if from as many episodes.

{truth}
{remark}
Made with {versions} by `{command}`.

## How they were made

```
python datasets/build_adroit.py {arguments}
```

`domains.load` makes them on first use, in the cache; the same seed and library versions give the same bytes on one kind
of processor. Torch's MKL has other kernels for Intel's than for others, which round the actions of policies otherwise,
and of that the simulator soon makes other roll-outs. With `MKL_CBWR=COMPATIBLE OPENBLAS_CORETYPE=Haswell` in the
environment all make the same.

## Origin, licence, use

Demonstrations and experts: aravindr93/hand_dapg (Apache-2.0). Target policies: google-research/deep_ope (Apache-2.0).
Environments: gymnasium-robotics (MIT). Roll-outs: made by the oat_gym developers (MIT). The demonstrations hold joint
angles and positions of a simulated hand, nothing of the people who moved it. For research on off-policy evaluation and
augmentation; a value here says nothing about a real robot.
"""
