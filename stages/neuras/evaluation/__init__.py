"""What is measured of a learned scene, and what it is compared with."""
