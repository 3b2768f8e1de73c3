"""The record: a Merkle log of events in a durable store, telemetry files, queries, verification (design, section 9)."""
