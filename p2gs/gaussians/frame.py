"""From the coordinates training used back to the input's. Every exporter starts here."""

from __future__ import annotations

import math
from dataclasses import replace

from p2gs.types import ArticulatedObject, Camera, GaussianTensors, Joint, Part, Similarity


def gaussians_to_input(gaussians: GaussianTensors, similarity: Similarity) -> GaussianTensors:
    """Gaussians in input coordinates. A similarity without rotation leaves quaternions, opacities and SH as they
    are."""
    return GaussianTensors(
        similarity.to_input(gaussians.means),
        gaussians.quats,
        gaussians.log_scales - math.log(similarity.scale),
        gaussians.opacity_logits,
        gaussians.sh,
    )


def camera_to_input(camera: Camera, similarity: Similarity) -> Camera:
    """The same camera placed in input coordinates (depths come out in input units)."""
    R, t = camera.viewmat[:3, :3].double(), camera.viewmat[:3, 3].double()
    viewmat = camera.viewmat.double().clone()
    viewmat[:3, 3] = t / similarity.scale - R @ t.new_tensor(similarity.center)
    return replace(camera, viewmat=viewmat.to(camera.viewmat.dtype))


def joint_to_input(joint: Joint, similarity: Similarity) -> Joint:
    """A joint in input coordinates, float64. Angles stay; lengths are divided by the similarity's scale."""
    unit = 1.0 if joint.type == "revolute" else 1.0 / similarity.scale
    return Joint(
        joint.type,
        joint.axis.detach().double().cpu(),
        similarity.to_input(joint.origin.detach().double().cpu()),
        float(joint.motion) * unit,
        (float(joint.limits[0]) * unit, float(joint.limits[1]) * unit),
        similarity.transform_to_input(joint.transform.detach().double().cpu()),
    )


def part_to_input(part: Part, similarity: Similarity) -> Part:
    """A part with its joint and their alternatives in input coordinates."""
    if part.joint is None:
        return part
    joint, *others = (joint_to_input(j, similarity) for j in (part.joint, *part.alternatives))
    return replace(part, joint=joint, alternatives=tuple(others))


def object_to_input(obj: ArticulatedObject) -> ArticulatedObject:
    """The whole twin in input coordinates, on the CPU, with the identity similarity."""
    gaussians = gaussians_to_input(obj.gaussians.detach(), obj.similarity)
    parts = [part_to_input(p, obj.similarity) for p in obj.parts]
    gaussians = GaussianTensors(*(getattr(gaussians, n).cpu() for n in GaussianTensors.NAMES))
    return ArticulatedObject(
        gaussians, obj.part_ids.detach().cpu().long(), parts, float(obj.canonical_time), Similarity()
    )


def with_counts(obj: ArticulatedObject) -> list[Part]:
    """The parts, each with the number of Gaussians that carry its id."""
    return [replace(p, gaussians=int((obj.part_ids == p.id).sum())) for p in obj.parts]
