"""Mitsuba 3 on this machine: ``backend`` finds the variant that works, ``trial`` is how it finds out. Neither knows a scene
of any system."""
