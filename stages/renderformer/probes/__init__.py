"""Probes: what the paper shows beyond the renderer, each one question with its own table and figure (its sections 4.1 to 4.3).

``probe``      what a probe is; sweeps of one setting, which most are
``sweeps``     the sweeps, figures 9 to 16
``made``       scenes built for the purpose: occluders, mirrors
``timing``     equal-time comparison (figure 5), time by stage (table 2)
``attention``  what a ray bundle looks at (figure 8)
``tokens``     what triangle tokens hold (figure 7)
``edits``      exact edits of scenes
``figures``    strips and curves

To add one: a ``Probe`` (or a ``Sweep``: a config with ``values``, and an ``edit``) listed in ``PROBES`` of its module, a short
file in conf/renderformer/probe/, a section in docs/probes.md.
"""
