"""Files: video, keypoints, cameras, tracks, overlays."""
