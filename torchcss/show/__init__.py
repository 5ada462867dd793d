"""Pictures of tracks: overlays, plots, the viewer, clicking."""
