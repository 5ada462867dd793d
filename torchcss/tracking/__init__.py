"""The tracking loop: settings, presets, session, and the moves of a body."""
