"""Attention made visible: what HCNet, KASSD and DenNet weigh on a sweep, as pictures."""
