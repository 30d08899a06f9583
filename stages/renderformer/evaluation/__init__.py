"""What *evaluate* is made of: baselines, the noise ceiling, statistics over scenes, times, the HTML report."""
