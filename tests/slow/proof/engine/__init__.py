"""The proof of the engine: random histories, and everything counted again from their stores."""
