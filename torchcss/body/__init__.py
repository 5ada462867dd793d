"""The articulated body; knows nothing of images."""
