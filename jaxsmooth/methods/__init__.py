"""Smoothing methods: frozen records that say how one step is made."""
