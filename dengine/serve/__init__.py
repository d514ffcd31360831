"""The cell's front: one engine behind HTTP, XML-RPC and OPC UA, and the page that people look at."""
