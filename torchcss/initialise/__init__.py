"""From joints in one image to hypotheses of the first pose."""
