"""Register a body to keypoints, masks, label maps and scans, over all frames."""
