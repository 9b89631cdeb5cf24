"""What `import tofuse` offers that needs more than one room: results that know what to do."""
