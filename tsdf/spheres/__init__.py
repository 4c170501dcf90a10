"""What stands between grains: packings of spheres, and the law of the gaps."""
