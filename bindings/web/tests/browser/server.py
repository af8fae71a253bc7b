"""Serves the folder that the argument names, and prints the port."""

import sys
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer


class Handler(SimpleHTTPRequestHandler):
    def end_headers(self):
        # The page must work offline by its own cache, not by the browser's.
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def copyfile(self, source, outputfile):
        # With `?slow` a document comes in pieces, so that a browser shows parts of it.
        if not self.path.endswith("?slow"):
            return super().copyfile(source, outputfile)
        while piece := source.read(1000):
            outputfile.write(piece)
            time.sleep(0.06)


server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=sys.argv[1]))
print(server.server_port, flush=True)
server.serve_forever()
