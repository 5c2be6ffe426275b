"""A page in the browser: a picture, its lens and a view, before and after. `page` and `answers` alone need Gradio."""
