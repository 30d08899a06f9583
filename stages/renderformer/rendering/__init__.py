"""Ground truth by path tracing with Mitsuba 3 (paper, section 3.3): heavy code behind the render stage and ``lightmill
trace``.

``render.render_views`` is what others call, and ``texels.texel_radiance`` for light at points on triangles.
``surfaces`` makes Mitsuba scenes from a SceneRecord's arrays. ``jit`` is the integrator of our own that keeps lights apart
(CUDA, LLVM), with ``material``, ``lights``, ``guiding`` and ``sobol``, and with ``caustics``, its paths that start at the
lamps; ``allotment`` tells how many. ``scalar`` fills the same interface where nothing can be compiled. Both hand over
``sums``. ``error`` estimates how far a view is from the truth, ``noise`` how far a dataset is; ``sheet`` draws it. The
Mitsuba variant comes from ``stages.graphics.mitsuba``, denoising from ``stages.graphics.denoising``.
"""
