"""The method of moving asymptotes, and the stages that make a robot with it."""
