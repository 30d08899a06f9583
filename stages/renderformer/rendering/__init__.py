"""Ground truth by path tracing with Mitsuba 3 (paper, section 3.3): heavy code behind the render stage and ``lightmill
trace``.

``backend`` finds the Mitsuba variant that works here; ``surfaces`` makes Mitsuba scenes from a SceneRecord's arrays;
``jit`` is the integrator of our own that keeps lights apart (CUDA, LLVM), with ``material``, ``lights`` and ``sobol``;
``scalar`` fills the same interface where nothing can be compiled. Both hand over ``sums``; ``denoising`` wraps Open Image
Denoise, ``error`` tells how far a view is from the truth, ``noise`` how far a dataset is, ``sheet`` draws it. What others call
is ``render.render_views``, and ``texels.texel_radiance`` for light at points on triangles.
"""
