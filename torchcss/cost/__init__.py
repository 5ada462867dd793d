"""Where body meets image: one term or prior a file, summed in `torchcss.cost.total`."""
