PYTHON ?= python3
BIN := .venv/bin

native:  ## rebuild the C++ extension of an editable install after an edit (seconds)
	cmake --build build/editable
	@rm -f $$($(BIN)/python -c "import sysconfig; print(sysconfig.get_path('platlib'))")/p2gs/_native*  # others may have it mapped
	@cmake --install build/editable --prefix $$($(BIN)/python -c "import sysconfig; print(sysconfig.get_path('platlib'))") >/dev/null

.PHONY: native
