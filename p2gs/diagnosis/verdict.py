"""What the diagnosis means, in sentences: simple rules over its figures, each with a limit that can be read here and in
the page."""

from __future__ import annotations

LIMITS = {
    "psnr": (25.0, "dB: a state that is reconstructed worse gives every later stage wrong surfaces"),
    "alpha_iou": (
        0.95,
        "a silhouette that overlaps the mask by less: cameras or masks are off, or training was too short",
    ),
    "fog": (0.7, "share of half-transparent Gaussians above which surfaces are not surfaces"),
    "moved": (30, "surface points that moved, both states together; with fewer there is nothing to find"),
    "moved_without_part": (0.25, "share of the moved surface that no part took: a part may be missing"),
    "moved_static": (0.25, "the same at the end, of the surface that the other state is seen to be empty at"),
    "bright_static": (
        0.1,
        "share of the object that is plainly wrong in both directions though nothing is said to move there",
    ),
    "close_call": (0.01, "relative difference of image loss below which two explanations cannot be told apart"),
    "ambiguous": (0.4, "share of a part's Gaussians with unclear labels"),
    "matched": (0.05, "share of a part's fused Gaussians with a partner in the other state"),
    "removed": (0.15, "share of the fused Gaussians that free space contradicted"),
    "learning": (1.25, "image loss after the articulation phase, as a multiple of that before"),
    "changed_degrees": (2.0, "degrees that the last polish turned a joint: it started far from where it ended"),
    "disagreement": (1.0, "per cent of the object's diagonal between the two directions of the last polish"),
    "contradicted": (0.1, "share of a part that lands where the other state is seen to be empty"),
    "coverage": (0.3, "share of a part that lands on a surface of the other state"),
    "residual": (4.0, "image residual of a moved part, as a multiple of the static part's"),
    "rise": (
        0.005,
        "growth of the residual when a part is displaced by 1 % of the diagonal: below, images do not hold the joint",
    ),
    "fall": (
        0.03,
        "share by which a small change of the joint lowers the residual: the joint is not at its best place",
    ),
    "confidence": (0.5, "confidence below which a joint is more likely wrong than right"),
}
STAGES = ("single_state", "discovery", "canonical_fusion", "articulation", "finish")


def verdicts(d: dict, diagonal: float) -> list[dict]:
    """[{"stage", "level": "warning" | "note", "text"}] in the order of the stages, from what ``diagnose`` returned.

    diagonal: of the object's box, in the diagnosis' units.
    """
    said: list[dict] = []

    def say(stage: str, text: str, level: str = "warning") -> None:
        said.append({"stage": stage, "level": level, "text": text})

    _reconstruction(d, say)
    _discovery(d, say)
    _static(d, say)
    _fusion(d, say)
    _articulation(d, say)
    _joints(d, say, diagonal)
    for note in d["finish"]["notes"]:
        say("finish", note + ".", "note")
    if not any(v["level"] == "warning" for v in said):
        n = len(d["joints"])
        say(
            "finish",
            f"Nothing speaks against the {n} joint{'s' * (n != 1)} that {'was' if n == 1 else 'were'} found.",
            "note",
        )
    return sorted(said, key=lambda v: STAGES.index(v["stage"]))


def lost_at(said: list[dict]) -> str | None:
    """The first stage that has a warning: what comes after it stands on it."""
    return next((v["stage"] for v in said if v["level"] == "warning"), None)


def limit(name: str) -> float:
    return LIMITS[name][0]


def _reconstruction(d: dict, say) -> None:
    for name, s in d["single_state"].items():
        if s["psnr"] < limit("psnr"):
            least = limit("psnr")
            say(
                "single_state",
                f"The {name} state is reconstructed poorly: {s['psnr']:.1f} dB on its photographs (below {least:g}).",
            )
        if s["alpha_iou"] < limit("alpha_iou"):
            least = limit("alpha_iou")
            say(
                "single_state",
                f"The {name} state's silhouette overlaps the masks by {s['alpha_iou']:.2f} only (below {least:g}).",
            )
        if s["fog"] > limit("fog"):
            most = limit("fog")
            say(
                "single_state",
                f"{s['fog']:.0%} of the {name} state's Gaussians are half-transparent (above {most:.0%}): fog.",
            )


def _discovery(d: dict, say) -> None:
    seen, found = d["motion_evidence"], d["discovery"]
    if seen is None:
        say("discovery", "Parts were learned without discovery: there is no motion evidence to look at.", "note")
        return
    moved = [s["moved"] for s in seen.values() if s.get("moved") is not None]
    if moved and sum(moved) < limit("moved"):
        say(
            "discovery",
            f"Next to nothing moved between the states: {sum(moved)} surface points (below {limit('moved')}).",
        )
    for name, s in seen.items():
        loose = s.get("moved_without_part", 0.0)
        if loose > limit("moved_without_part"):
            say(
                "discovery",
                f"{loose:.0%} of what moved in the {name} state belongs to no part: a part is missing, or a motion "
                "is wrong.",
            )
    if not found["parts"]:
        say("discovery", "No motion explains what moved: no moving part was found.")
    if found["chosen"] is not None and len(found["explanations"]) > 1:
        ranks = [e["rank"] for e in found["explanations"]]
        # one that was dismissed for its further part may have the lower energy
        gap = min(abs(r - ranks[found["chosen"]]) for i, r in enumerate(ranks) if i != found["chosen"])
        if gap < limit("close_call"):
            text = (
                f"Two explanations fit almost alike (energies {gap:.3f} apart): other parts are possible (try "
                "another seed)."
            )
            say("discovery", text, "note")
    chosen = found["explanations"][found["chosen"]] if found["chosen"] is not None else {}
    for r in chosen.get("reductions", []):
        what = {"merge": "was merged into a neighbour that moves alike", "drop": "was dropped"}[r["change"]]
        why = f"it {told_saved(r)}; energy without it {r['energy']:+.3f}"
        say("discovery", f"A {r['type']} part {what}: {why}.", "note")
    for pair in found.get("seamless", []):
        if pair.get("joined", True):  # older discoveries list no others
            start, end = (f"{100 * share:.0f} %" for share in pair["without_edge"])
            why = f"{start} of the start's photographs and {end} of the end's show no edge between them"
            say("discovery", f"Two parts became one: {why}, and surfaces do not tell them apart.", "note")
    for name, s in d["labels"].items():
        for k, share in enumerate(s["ambiguous_by_part"]):
            if k and share > limit("ambiguous"):
                say(
                    "discovery",
                    f"Part {k}: {share:.0%} of its Gaussians in the {name} state have unclear labels.",
                    "note",
                )


def told_saved(gone: dict) -> str:
    """What a part that discovery dropped or merged saved. Older discoveries, which ``--keep_stale`` keeps, have its
    share of the whole image loss (before 95d784a: two losses) in place of that in its own pixels."""
    if "own_share" in gone:
        return f"saved {100 * gone['own_share']:.0f} % of the image loss in its own pixels"
    share = gone["saved"] if "saved" in gone else 1 - gone["cost_with"] / gone["cost_without"]
    return f"saved {100 * share:.1f} % of the image loss"


def _static(d: dict, say) -> None:
    """What moved and is called static all the same: by free space, and by the images."""
    for name, s in d["labels"].items():
        if s["moved"] < limit("moved") or s["moved_static"] <= limit("moved_static"):
            continue
        known = (d["motion_evidence"] or {}).get(name, {}).get("moved_without_part")
        if known is None or known <= limit("moved_without_part"):  # else discovery has said so
            text = (
                f"{s['moved_static']:.0%} of what moved in the {name} state is called static in the twin: a part "
                "is missing."
            )
            say("discovery" if known is None else "articulation", text)
    wrong = min(r["bright_static"] for r in d["residuals"].values())
    if wrong > limit("bright_static"):
        text = (
            f"{wrong:.0%} of the object is wrong both ways where nothing is said to move: a moving piece was left "
            "with the base."
        )
        say("discovery", text)


def _fusion(d: dict, say) -> None:
    f = d["fusion"]
    for k, (n, m) in enumerate(zip(f["gaussians"], f["matched"], strict=True)):
        if k and m < limit("matched") * n:
            say(
                "canonical_fusion",
                f"Part {k} of discovery: {m} of its {n} Gaussians have a partner in the other state.",
            )
    removed = (f["relabelled"] or 0) + (f["dropped"] or 0)
    if removed > limit("removed") * (sum(f["gaussians"]) + (f["dropped"] or 0)):
        say(
            "canonical_fusion",
            f"{removed} Gaussians were relabelled or dropped because the other state is seen to be empty there.",
        )


def _articulation(d: dict, say) -> None:
    a = d["articulation"]
    start, end = a["image_loss_start"], a["image_loss_end"]
    if start and end > limit("learning") * start:
        say("articulation", f"Learning made the images worse: loss {start:.4f} before, {end:.4f} after.")


def _joints(d: dict, say, diagonal: float) -> None:
    polish = {j["part"]: j for j in d["polish"]["joints"]}
    for j in d["joints"]:
        name, p = f"Part {j['part']}", polish.get(j["part"], {})
        reasons = []
        if j["views"] == 0:
            reasons.append("no photograph shows enough of it to be measured")
        apart = p.get("disagreement")
        if apart is not None and 100 * apart / diagonal > limit("disagreement"):
            turn = p["disagreement_degrees"]
            size = f"{turn:.1f} deg" if j["type"] == "revolute" else f"{apart:.3g}"
            reasons.append(f"forward and backward polish disagree by {size}")
        if p.get("changed_degrees", 0.0) > limit("changed_degrees"):
            reasons.append(f"the last polish turned it by {p['changed_degrees']:.1f} deg, so it came in wrong")
        if j["contradicted"] > limit("contradicted"):
            reasons.append(f"{j['contradicted']:.0%} of it lands where the other state is seen to be empty")
        if j["coverage"] < limit("coverage"):
            reasons.append(f"only {j['coverage']:.0%} of it lands on a surface of the other state")
        if (j["residual"] or 0.0) > limit("residual"):
            reasons.append(f"moved into the other state it looks {j['residual']:.1f} times worse than the static part")
        if j["rise"] < limit("rise"):
            reasons.append("the images hardly hold it: a small displacement does not make them worse")
        if j["fall"] > limit("fall"):
            reasons.append(f"a small change of the joint makes the images {j['fall']:.0%} better")
        why = "; ".join(reasons) or "several measures together speak against it"
        if j["confidence"] < limit("confidence"):
            text = f"{name} ({j['type']}): {why}; its motion is not reliable (confidence {j['confidence']:.2f})"
            earlier = j["confidence_by_stage"]
            if "discovery" in earlier:
                text += (
                    f"; discovery handed it over with {earlier['discovery']:.2f}, articulation with "
                    f"{earlier['articulation']:.2f}"
                )
            say(next(s for s, c in earlier.items() if c < limit("confidence")), text + ".")
        elif reasons:
            say("finish", f"{name} ({j['type']}): {why} (confidence {j['confidence']:.2f}).", "note")
