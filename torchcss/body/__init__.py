"""The articulated body: tree, flesh and derivatives; it knows nothing of images."""
