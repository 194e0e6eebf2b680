"""The simulation in three differentiable peers, each with its own automatic differentiation."""
