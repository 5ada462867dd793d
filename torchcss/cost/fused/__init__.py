"""The fused evaluation engine: compiled twins of the terms, for pools of states on a CPU."""
