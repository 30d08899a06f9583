"""What each numbered stage does, the records they exchange, and the ``lightmill`` command."""
