"""Which sizes objects have: what ``p2gs export`` warns by, since photographs alone do not tell metres."""

from __future__ import annotations

import re
from typing import Optional

LIKELY = (0.05, 3.0)  # m, longest side: a stapler to a wardrobe
KINDS = {  # m, longest side at the start: generous, a size outside is a wrong unit rather than a rare object
    "laptop": (0.2, 0.7),  # open, too
    "microwave": (0.35, 0.9),
    "oven": (0.4, 1.2),
    "dishwasher": (0.4, 1.2),
    "fridge": (0.4, 2.2),
    "refrigerator": (0.4, 2.2),
    "cupboard": (0.3, 3.0),
    "wardrobe": (0.8, 3.0),
    "suitcase": (0.3, 1.1),
    "toilet": (0.4, 1.1),
    "faucet": (0.08, 0.7),
    "kettle": (0.12, 0.5),
    "stapler": (0.05, 0.4),
    "scissors": (0.08, 0.4),
    "pliers": (0.08, 0.4),
    "knife": (0.05, 0.5),
    "blade": (0.05, 0.5),
    "bottle": (0.08, 0.6),
    "printer": (0.2, 1.2),
    "phone": (0.08, 0.4),
}


def unlikely_size(longest: float, told: str = "") -> Optional[str]:
    """A sentence where the longest side [m] is none that such an object has, or any in a household. told: what may name
    its kind, as a folder or a category does."""
    name = next((w for w in re.split(r"[^a-z]+", told.lower()) if w in KINDS), "")
    low, high = KINDS.get(name, LIKELY)
    if low <= longest <= high:
        return None
    usual = f" (a {name}: {low:g} to {high:g})" if name else ""
    return (
        f"the object's longest side comes out as {longest:.3g} m{usual}: give metres per unit of the input with "
        "--scale, or its --height"
    )
