"""Where body meets image: one term a file."""
