"""Everything on a GPU: decisions of the hard cases, then timings, then a report."""
