"""Waymo Open Dataset, perception: v2 (parquet files by component) and v1 (TFRecord files of `Frame` messages)."""
