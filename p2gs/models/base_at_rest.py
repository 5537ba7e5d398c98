"""What registration left between the states, once it is known what the base is.

Before discovery only surfaces that agree tell how the states lie to one another, and what moved a little agrees a
little. With the parts known the base is refined by photographs as they are, one rigid motion among the others; what it
moves by is the states' misalignment, and would else be in every joint.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from p2gs.context import RunContext
from p2gs.gaussians.handover import Articulation, PartMotions, Registration, StateGaussians
from p2gs.models.finish import FinishConfig, clean_labels, state_labels
from p2gs.models.registered import REGISTRATION, register_state, register_views, write_registration
from p2gs.motion.joint_confidence import common_level, state_depth
from p2gs.motion.refine_motions import Judge
from p2gs.ops import se3, so3


def motion_of_base(
    learned: Articulation, states: list[StateGaussians], views, config: FinishConfig, seed: int, backend: str, device
) -> Tensor:
    """[4, 4] float64: how the base moves from start to end by both states' photographs; the identity where they are
    explained no better with it."""
    labels = clean_labels(learned.gaussians, learned.part_ids, len(learned.types) + 1, config.clean_neighbours)
    found = [state_labels(learned, labels, s, learned.transforms) for s in states]
    options, level = {"backend": backend, "device": device}, common_level(views)
    stacks = [state_depth(s, views[s.state], level, **options) for s in states]
    still = torch.eye(4, dtype=torch.float64)[None]
    bodies = PartMotions(
        ["free", *learned.types],
        torch.cat([still, learned.transforms]),
        torch.ones(len(learned.types) + 1),
        [label + 1 for label, _ in found],
        [margin for _, margin in found],
    )
    judge = Judge(None, states, views, config.polish, stacks, seed, **options)
    return judge.no_worse(bodies, judge.refine(bodies)).transforms[0]


def put_base_to_rest(
    run: RunContext,
    config: FinishConfig,
    learned: Articulation,
    read: list[StateGaussians],
    states: list[StateGaussians],
    registration: Registration,
) -> tuple[Articulation, list[StateGaussians]]:
    """What was learned, and the states, with the end where its base lies on the start's; so are the run's scene and
    RUN/registration.json.

    read: the single states, whose corrections of photographs the file has.  registration: what was applied before.
    """
    base = motion_of_base(learned, states, run.views, config, run.seed, run.backend, run.device)
    left = Registration(se3.inverse(base), torch.zeros(3))
    if left.is_identity:
        return learned, states
    points = states[1].gaussians.means.double().cpu()
    shift = float((se3.apply(base, points) - points).norm(dim=1).square().mean().sqrt()) / run.extent
    angle = float(torch.rad2deg(so3.rotation_angle(base[:3, :3])))
    run.log(
        "finish", f"the end's base lay {100 * shift:.3f} % of the object and {angle:.3f} degrees beside the start's"
    )
    figures = registration.figures | {"base": {"shift": shift, "angle": angle}}
    whole = Registration(left.transform @ registration.transform, registration.log_gain, figures)
    write_registration(run.run_dir / REGISTRATION, whole, read, run.scene_as_read)
    run.take(register_views(run.scene, left))
    return replace(learned, transforms=left.transform @ learned.transforms), [register_state(s, left) for s in states]
