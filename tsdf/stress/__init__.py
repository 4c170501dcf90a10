"""Stress: situations in which methods fail, ours and those of other software, measured; see docs/stress.md."""
