# An inline function that a rows_*.cpp leaves as a symbol of its own was compiled for one instruction set and may be
# linked into code that runs on machines without it. Only what lies in that set's own namespace may stay.
execute_process(COMMAND ${NM} -A -C --defined-only ${LIBRARY} OUTPUT_VARIABLE symbols RESULT_VARIABLE code)
string(REGEX MATCHALL "[^\n]*rows_[^\n]* [Wu] [^\n]*" weak "${symbols}")
list(FILTER weak EXCLUDE REGEX "_isa::")
if(NOT code EQUAL 0 OR NOT symbols MATCHES "rows_baseline" OR weak)
  message(FATAL_ERROR "${weak}")
endif()
