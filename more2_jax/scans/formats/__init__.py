"""The formats of scans, a module each; `registry` lists them."""
