"""The `torchcss` command."""
