"""The migrations, one a schema."""
