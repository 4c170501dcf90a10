"""Installed as ``tsdf.cli``."""
