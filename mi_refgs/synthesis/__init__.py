"""Path-traced data sets with ground truth."""
