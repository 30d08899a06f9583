"""Readers of captures: every kind of set on disk ends as the same frames, points and facts (``sources.Source``)."""
