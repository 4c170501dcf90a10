"""Installed as ``tsdf.schema``."""
