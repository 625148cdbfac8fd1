"""The back end: keyframes and place candidates to verified loops and one consistent map."""
