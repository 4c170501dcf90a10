"""Plans: which level a picture needs, predicted before it is rendered; and pictures that are rendered as planned."""
