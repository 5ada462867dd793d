"""Search over any cost with value, gradient and Hessian; knows no bodies and no images."""
