"""What a finished design is worth: without grey, in other discretisations, in motion."""
