"""What makes a part one part: one body with one motion."""
