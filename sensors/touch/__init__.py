"""Touch: contact models, likelihoods of touches, tactile pads and soft bubbles."""
