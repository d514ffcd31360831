"""The null test: shuffled labels, of which no network can learn anything that is counted."""
