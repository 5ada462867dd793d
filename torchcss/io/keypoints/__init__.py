"""2D keypoints as other programs write them."""
