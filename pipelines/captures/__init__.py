"""Write reports of a capture's check, and keypoints and masks of its images."""
