"""Photographs of two joint states, as a phone takes them, to a scene folder: ``p2gs data capture``.

The stages in their order, a module each: ``photos`` and ``video`` (upright copies), ``solve`` (each state reconstructed
by ``sfm`` in a child process, how the states lie to one another by ``hypotheses``, one model of both by ``joint``) or
``poses`` (that somebody has already), ``gains`` (exposure), ``world`` (up, scale, the object's box), ``auto_masks`` or
``given_masks``, ``write``, ``page``. ``pipeline`` runs them, ``cache`` keeps what they made.
"""
