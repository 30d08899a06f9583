"""A made-up place, path traced: the embedded default of the stage capture. ``source`` is what the stage calls."""
