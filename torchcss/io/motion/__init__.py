"""Motion capture as other programs write it."""
