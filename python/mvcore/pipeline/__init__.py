"""The stages of a reconstruction and what runs them."""
