"""Poses refined by silhouettes."""
