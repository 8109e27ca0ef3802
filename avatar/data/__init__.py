"""A capture as training sees it: views, poses, and what is kept in memory."""
