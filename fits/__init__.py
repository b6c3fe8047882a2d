"""Fits of atmospheres to measured skies."""
