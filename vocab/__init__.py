"""The vocabulary: descriptors to visual words, votes and colour histograms to ranked places."""
