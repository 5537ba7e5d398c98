"""Scores against ground truth: ``joints``, ``chamfer``, ``image``, ``penetration`` (functions), ``modules``
(torchmetrics classes)."""
