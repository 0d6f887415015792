"""What people read of a run: pages, plots, tables; the demo."""
