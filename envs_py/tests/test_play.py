"""The page of `dmprl play`, and the user's module folders."""

import http.client
import importlib
import sys
import tempfile
import threading
import unittest
from pathlib import Path
from unittest import mock

from dmprl import python_path
from dmprl.play import Server, Show


class PageTest(unittest.TestCase):
    def test_a_title_is_text_and_not_html(self):
        with Server(0, Show("<script>alert('x')</script> & \"y\"")) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            self.addCleanup(server.shutdown)
            connection = http.client.HTTPConnection(*server.server_address, timeout=60)
            self.addCleanup(connection.close)
            connection.request("GET", "/")
            page = connection.getresponse().read().decode()
        self.assertNotIn("<script>", page)
        self.assertEqual(page.count("&lt;script&gt;alert(&#x27;x&#x27;)&lt;/script&gt; &amp;"), 2)


class PythonPathTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        patched = mock.patch.object(sys, "path", list(sys.path))
        patched.start()
        self.addCleanup(patched.stop)

    def test_folders_come_after_standard_library_and_packages(self):
        (self.folder / "of_a_user_1.py").write_text("x = 1")
        (self.folder / "numpy.py").write_text("raise AssertionError")
        (self.folder / "email").mkdir()  # data, not a module
        before = list(sys.path)
        python_path.extend([str(self.folder)])
        self.assertEqual(sys.path, [*before, str(self.folder)])
        self.assertEqual(importlib.import_module("of_a_user_1").x, 1)

    def test_a_module_with_the_name_of_a_standard_one_is_an_error(self):
        before = list(sys.path)
        package = self.folder / "email"
        package.mkdir()
        for file in (self.folder / "random.py", package / "__init__.py"):
            file.touch()
            with self.assertRaisesRegex(ImportError, "standard library; rename yours") as raised:
                python_path.extend([str(self.folder)])
            self.assertIn(str(file.parent.parent), f"{raised.exception}")
            file.unlink()
        self.assertEqual(sys.path, before)


if __name__ == "__main__":
    unittest.main()
