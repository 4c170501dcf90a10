"""What is asked for: levels, media and scene files, without a kernel."""
