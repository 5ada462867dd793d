"""torchcss: articulated tracking from one camera that keeps every explanation."""
