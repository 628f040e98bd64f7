"""Methods side by side: many fits, each a run of its own, and the tables, plots and page made of them."""
