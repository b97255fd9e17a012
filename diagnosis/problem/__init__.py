"""A session and its twin as one problem: residual, nuisances, responses to every effect."""
