"""The front end: images to corners, tracks, visual odometry and keyframes."""
