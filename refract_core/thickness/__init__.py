"""The shape of glass: how thick it is by rays, and which model suits it. Arrays in, arrays out; knows no stage."""

__all__ = ["fit", "measure", "picture", "unwrap"]
