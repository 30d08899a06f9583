"""Ground truth by path tracing with Mitsuba 3 (paper, section 3.3): heavy code behind the render stage and ``lightmill
trace``.

``backend`` finds the Mitsuba variant that works here; ``surfaces`` makes Mitsuba scenes from a SceneRecord's arrays;
``jit`` is the integrator of our own that keeps lights apart (CUDA, LLVM); ``scalar`` fills the same interface where
nothing can be compiled; ``denoising`` wraps Open Image Denoise; ``render`` is what others call: ``render_views``.
"""
