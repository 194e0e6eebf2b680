"""Scenes that provoke every way in which the method fails; `stability_map.py` runs them all."""
