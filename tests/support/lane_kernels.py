"""Small kernels as text of LLVM IR, written out by hand: the lanes are a plain loop."""

WIDTH = 4

# The code for member `%i`, given the addresses of arrays of float64.
TRIPLE = """
  %x_at = getelementptr double, ptr %x, i64 %i
  %value = load double, ptr %x_at
  %tripled = fmul double %value, 3.0
  %y_at = getelementptr double, ptr %y, i64 %i
  store double %tripled, ptr %y_at
"""

# Add the first number of the second operand, which all members share.
SHARED = """
  %x_at = getelementptr double, ptr %x, i64 %i
  %value = load double, ptr %x_at
  %shared_at = getelementptr ptr, ptr %operands, i64 1
  %shared = load ptr, ptr %shared_at
  %added = load double, ptr %shared
  %sum = fadd double %value, %added
  %y_at = getelementptr double, ptr %y, i64 %i
  store double %sum, ptr %y_at
"""

# Sleep for the operand's number of ms, and return how many threads were doing so.
COUNT_THREADS = """
  %running = atomicrmw add ptr @running, i32 1 seq_cst
  %x_at = getelementptr double, ptr %x, i64 %i
  %ms = load double, ptr %x_at
  %us = fmul double %ms, 1000.0
  %time = fptoui double %us to i32
  call i32 @usleep(i32 %time)
  %threads = load atomic i32, ptr @running seq_cst, align 4
  %count = sitofp i32 %threads to double
  %y_at = getelementptr double, ptr %y, i64 %i
  store double %count, ptr %y_at
  atomicrmw sub ptr @running, i32 1 seq_cst
"""
RUNNING = "@running = internal global i32 0\ndeclare i32 @usleep(i32)\n"


def kernel_ir(body: str, width: int = WIDTH, before: str = "") -> str:
    """Return a kernel that runs `body` for each of `width` members in turn."""
    return f"""
{before}
define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {{
entry:
  %x = load ptr, ptr %operands
  %y = load ptr, ptr %results
  br label %next
next:
  %lane = phi i64 [0, %entry], [%lane_next, %next]
  %here = add i64 %first, %lane
  %is_surplus = icmp sgt i64 %here, %last
  %i = select i1 %is_surplus, i64 %last, i64 %here
{body}
  %lane_next = add i64 %lane, 1
  %is_more = icmp slt i64 %lane_next, {width}
  br i1 %is_more, label %next, label %end
end:
  ret i1 false
}}
"""


# Products of vectors, as in the kernels that are generated for programs.
VECTORS = """
define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {
  %x = load ptr, ptr %operands
  %y = load ptr, ptr %results
  %x_at = getelementptr double, ptr %x, i64 %first
  %value = load <8 x double>, ptr %x_at, align 8
  %square = fmul contract <8 x double> %value, %value
  %cube = fmul contract <8 x double> %square, %value
  %sum = fadd contract <8 x double> %cube, %square
  %y_at = getelementptr double, ptr %y, i64 %first
  store <8 x double> %sum, ptr %y_at, align 8
  ret i1 false
}
"""
