"""Photographs of two joint states, as a phone takes them, to a scene folder: ``p2gs data capture``.

The stages in their order, a module each: ``photos`` (upright copies), ``sfm`` (each state reconstructed, in a child
process), ``hypotheses`` (how the states lie to one another), ``joint`` (one model of both), ``frame`` (scale and up),
``gains`` (exposure), ``region`` (the object's box), ``masks``, ``write``. ``pipeline`` runs them.
"""
