"""Where surfels start, one file for each way: a function from data and random draws to points."""
