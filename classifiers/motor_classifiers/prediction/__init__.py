"""The learned opinion on recordings and on the cases of data sets."""
