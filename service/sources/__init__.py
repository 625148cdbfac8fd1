"""Sources of frames: data sets on disk, folders of images, videos, rendered worlds."""
