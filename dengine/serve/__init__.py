"""The server of a cell: one engine behind HTTP, XML-RPC and OPC UA, and the web page."""
