"""The only rooms that know USD: stages in, plain arrays out."""
