"""The server of a cell: one engine behind HTTP, XML-RPC and OPC UA, and the web page. This file
holds no code; `dengine serve` calls `server.serve`.
"""
