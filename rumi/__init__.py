"""Find the pose of an object by touching and pushing it (RUMI, arXiv 2408.10450).

The loop is `rumi.loop.rummage`; the parts it is made of lie in `rumi.belief`, `rumi.registration`, `rumi.fields`,
`rumi.dynamics` and `rumi.planning`, and each can be used alone.
"""

__version__ = "0.1.0"
