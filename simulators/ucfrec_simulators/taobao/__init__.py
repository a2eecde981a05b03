"""Worlds of pages and shoppers: VirtualTaobao and one of our own."""
