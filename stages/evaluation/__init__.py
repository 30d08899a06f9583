"""What *evaluate* is made of: baselines, statistics over scenes, the HTML report."""
