"""Outlines of masks as distance fields, and how well they fit together."""
