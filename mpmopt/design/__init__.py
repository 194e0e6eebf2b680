"""From design variables to a distance and its gradient."""
