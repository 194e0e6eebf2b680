"""Bodies run forward and back, what is kept of them, and how close they came to failure."""
